"""A leaderboard: the same tasks, worlds and seeds for every controller, by a protocol that does not change."""
