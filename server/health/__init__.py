"""The state of the service for operators: readiness, devices, estimates, gauges, logs."""
