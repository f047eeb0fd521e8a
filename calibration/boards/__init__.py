"""Single cameras by a board: what is printed, where its corners are in pictures, intrinsics and their evidence."""
