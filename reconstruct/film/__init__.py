"""Films of a scene: where the camera goes, when pictures are taken, what they show, and how a film is made.

Novel views are only good between views that were seen, so every path but one of a file is made from the places that
cameras looked from. Everything is in the box frame.
"""
