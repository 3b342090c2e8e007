"""Photos with known cameras: readers, lenses, pixels and points."""
