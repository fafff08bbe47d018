"""`uavpose-replay score DIR`: compares what a flight's peers received with ground truth; figures and report.html."""
