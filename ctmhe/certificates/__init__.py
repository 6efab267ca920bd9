"""What is guaranteed, computed from a model and a domain: numbers for estimators and triggers."""
