"""The state of the service for operators: readiness, estimates, gauges, logs."""
