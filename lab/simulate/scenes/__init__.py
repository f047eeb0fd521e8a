"""What is filmed: objects, rooms, textures, and the options of a session."""
