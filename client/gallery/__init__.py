"""Small scenes, each of which calls for a known set of effects: `synthetic:gallery/NAME`."""
