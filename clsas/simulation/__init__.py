"""What would be received: scenes and the simulator."""
