"""What is asked for: the typed configuration, its composition from conf/, the cells of a sweep."""
