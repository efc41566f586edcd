"""The state of the service for operators: readiness, devices, estimates, metrics, logs."""
