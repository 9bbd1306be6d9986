"""Estimation of the water's refractive index from a target on the vehicle."""
