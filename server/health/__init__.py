"""Health of the service for operators: readiness, resource estimates, Prometheus gauges and logs."""
