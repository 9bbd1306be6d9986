"""Calibration of the lens's position in the dome and of the camera's orientation."""
