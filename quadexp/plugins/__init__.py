"""What ships beside the core in the shape of a plug-in of a user: a folder each, that says in BRINGS what it brings."""
