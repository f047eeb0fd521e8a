"""Keys of scene.yaml that earlier versions had and this one has not.

A scene.yaml with one of them is refused like one with any other unknown key, but is told that the key is gone.
"""

GONE: dict[str, str] = {
    "reconstruct.learn_clocks": "is gone: `tiny` and `fast` look for a camera whose clock is wrong by themselves; "
    "remove the key",
}
"""Dotted key -> what is said of it: that it is gone, what does its work now, what to do."""
