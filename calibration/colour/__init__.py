"""Cameras brought to one look: which surface points two pictures share, and what linear correction they ask for."""
