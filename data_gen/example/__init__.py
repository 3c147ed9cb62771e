"""A worked example of a user's own scene (docs/own_scene.md)."""
