"""Rigid transforms, rays and planes."""

from aqualvs.geometry.planes import Plane, Rays
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec, rotvec_from_rotation

__all__ = ["SE3", "Plane", "Rays", "rotation_from_rotvec", "rotvec_from_rotation"]
