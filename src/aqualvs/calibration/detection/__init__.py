"""Detection of targets in pictures, to a few hundredths of a pixel."""
