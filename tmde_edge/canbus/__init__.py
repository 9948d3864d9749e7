"""Pure CAN codecs: vehicle signals in, alert frames out."""
