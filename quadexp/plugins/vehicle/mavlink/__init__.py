"""A bridge to a flight stack over MAVLink: its estimate in, body rates and thrust out."""
