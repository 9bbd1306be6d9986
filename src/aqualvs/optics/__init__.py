"""Refraction, the camera behind a dome, water, and the rig file."""

from aqualvs.optics.water import seawater_index_vacuum

__all__ = ["seawater_index_vacuum"]
