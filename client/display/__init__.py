"""Answers on this side: layers composed over camera pictures, the terminal view."""
