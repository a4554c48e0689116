"""Equations of motion and aerodynamics as CasADi expressions, each written once."""
