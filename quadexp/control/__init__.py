"""Controllers: what turns a measured state and a reference into rotor thrusts."""
