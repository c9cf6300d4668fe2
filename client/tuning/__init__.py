"""Measurement of accuracy against time on a device (`probeless tune`)."""
