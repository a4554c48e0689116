"""Remedies against measurements that come late and commands that act late."""
