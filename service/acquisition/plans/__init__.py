"""What is captured: plans, and the pictures that they ask for."""
