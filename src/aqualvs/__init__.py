"""Underwater laser vision: posture to a net or wall from a camera behind a dome and line lasers."""

__version__ = "0.1.0"
