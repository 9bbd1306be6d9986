"""From a frame to stripe peaks, surfaces and posture.

Imports optics and geometry. `aqualvs.scanner` puts the stages together.
"""
