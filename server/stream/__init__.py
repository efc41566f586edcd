"""Subscriptions: who listens, what is sent, what is asked once for all."""
