"""scene.yaml: its keys, and everything that is wrong with one."""
