"""Least squares with estimated covariance: residual blocks, bundle adjustment, priors."""
