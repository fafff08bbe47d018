"""`uavpose-replay score DIR`: what a flight's peers received, set against the truth, as figures and as report.html."""
