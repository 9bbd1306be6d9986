"""Calibration of the lens's place in the dome and of the camera's orientation."""
