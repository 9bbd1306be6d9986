"""Dynamics of a simulated vehicle in moving water."""
