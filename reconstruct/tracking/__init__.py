"""What moves, followed through time: points on its surface, one deformation graph, rigid parts."""
