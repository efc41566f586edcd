"""WebSocket subscriptions to scenes: subscribers, their outgoing messages and their live queries."""
