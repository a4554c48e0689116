"""What stands beside the core: each folder has the shape of a user's own plug-in, and the core imports none of it."""
