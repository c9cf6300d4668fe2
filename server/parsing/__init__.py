"""Meshes and pictures of strangers, read in processes of their own that may die without taking the server along."""
