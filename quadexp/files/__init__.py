"""Files on disk: the one writer, file names made from names, and the private folder of what can be made again."""
