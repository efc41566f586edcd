"""Subscriptions: listeners of scenes, their messages, and queries shared among them."""
