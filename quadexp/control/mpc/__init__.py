"""Model predictive control: real-time SQP iteration, Riccati recursion, exact input bounds by an active set."""
