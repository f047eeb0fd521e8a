"""The trained model as geometry, for other programs: what is where at a time, seen surfaces, points, meshes, grids."""
