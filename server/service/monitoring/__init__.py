"""What operators see: metrics, the log, the console."""
