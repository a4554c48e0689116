"""What is beside the core: each in a folder of its own, in the shape of what others bring."""
