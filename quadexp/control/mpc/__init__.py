"""The model predictive controller: real-time SQP on Riccati factors, with exact bounds."""
