"""The same net on several dates: how fouling grew, which holes are new."""
