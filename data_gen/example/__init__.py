"""A worked example of a scene of one's own (docs/own_scene.md)."""
