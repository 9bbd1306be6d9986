"""Least squares with an honest covariance: residual blocks, bundle adjustment, priors."""
