"""What a connection meets before its session: limits, timeouts, TLS, the token, proxies."""
