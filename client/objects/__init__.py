"""Files of virtual objects: parsing, packing into one message, placing."""
