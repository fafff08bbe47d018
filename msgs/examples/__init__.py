"""Small example programs to start from; each needs zenoh, numpy and xxhash, nothing else.

python -m msgs.examples.print_poses -e tcp/127.0.0.1:7448 -u uav1
"""
