"""Calibration of the laser sheets from stripes on boxes, boards and walls."""
