"""CAN buses and CAN log files."""
