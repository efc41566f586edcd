"""WebSocket subscriptions to scenes: subscribers, their outgoing messages, and live queries."""
