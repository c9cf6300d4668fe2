"""Options of the command line: declaration, checks, and the capture that they describe."""
