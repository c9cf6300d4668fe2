"""The wire contract between thin clients and the server. Imports nothing else of the project."""
