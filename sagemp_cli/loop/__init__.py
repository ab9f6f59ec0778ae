"""The closed loop that is proved about: robot, tracker and reference put together."""
