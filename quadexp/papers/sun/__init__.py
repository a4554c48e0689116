"""The comparison of Sun et al. 2022: its ellipses, its published tables, and ours beside them."""
