"""Performance measurements on this machine: bandwidth, steps per second, memory."""
