"""Measurements of this program on this machine: bandwidth, steps per second, memory."""
