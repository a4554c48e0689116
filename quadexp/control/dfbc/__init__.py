"""Control by differential flatness with a constrained allocation (Sun et al. 2022)."""
