"""Source: an OAK-D camera."""
