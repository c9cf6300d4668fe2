"""The wire format between clients and the server. Imports nothing else of the project."""
