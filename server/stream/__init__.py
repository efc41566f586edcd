"""Subscriptions: the listeners of scenes, their messages and their live queries."""
