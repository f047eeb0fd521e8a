"""Structure from motion of the sweep: pictures, masks, pairs, the mapper's process, and checks of what came out."""
