"""Run the stages of a scene, and lose nothing whatever happens."""
