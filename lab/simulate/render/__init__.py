"""Pictures of a scene, as a camera would record them, and the exact truth of them."""
