"""A leaderboard: the same tasks, worlds and seeds for every controller, by a protocol that does not change."""

BRINGS = {
    "commands": {"bench": "quadexp.plugins.bench.commands:bench"},
    "api": {"bench": "quadexp.plugins.bench.api:bench", "Leaderboard": "quadexp.plugins.bench.api:Leaderboard"},
    "kinds": {"leaderboard": "bench a leaderboard"},
    "columns": {"bench": "quadexp.plugins.bench.columns:COLUMNS"},
    "tables": {"leaderboard": "quadexp.plugins.bench.api:Leaderboard"},
    "reads": {"bench": "ENGINE", "bench --controller": "CONTROLLER"},
}
