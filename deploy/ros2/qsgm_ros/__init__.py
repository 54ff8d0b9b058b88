"""Teach an object from one camera image and find it in those that follow.

images  sensor_msgs/Image to a frame and back; no ROS in it
finder  what is taught and found, as messages; no ROS in it
node    topics, service and parameters around it
"""
