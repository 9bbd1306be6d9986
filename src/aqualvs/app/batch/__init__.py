"""Many dives at once: cut into pieces, measured by many processes, joined again."""
