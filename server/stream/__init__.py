"""Subscriptions: the subscribers of scenes, their messages and their live queries."""
