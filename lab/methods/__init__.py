"""Methods for moving scenes, written from their papers, to compare DeVRF with on the same data and clock."""
