"""The Zenoh side: session, keys, codec, query handlers and client."""
