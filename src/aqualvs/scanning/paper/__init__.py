"""The paper's own stripe detector and mesh filter, kept for comparison."""
