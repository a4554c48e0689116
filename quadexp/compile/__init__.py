"""Back ends: CasADi functions interpreted, or compiled as C and cached."""
