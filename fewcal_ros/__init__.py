"""Recordings, the command line and the node: everything between ROS and the library fewcal."""
