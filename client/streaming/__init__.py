"""Python client of the protocol, for any program that sends frames or watches."""
