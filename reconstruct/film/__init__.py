"""Films of a scene: where the camera goes, how time runs, what is shown beside colour.

Novel views are only good between views that were seen, so every path is made from the places that cameras looked
from. Everything is in the box frame.
"""
