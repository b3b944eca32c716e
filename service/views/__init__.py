"""What the service answers with: one model an answer and the states in it, shared by the API and its client."""
