"""Small scenes, each of which needs a known set of effects: `synthetic:gallery/NAME`."""
