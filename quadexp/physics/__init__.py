"""Equations of motion and of the air, each written once, as CasADi expressions."""
