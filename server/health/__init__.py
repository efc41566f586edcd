"""The state of the service for operators: readiness, estimates, gauges for Prometheus, logs."""
