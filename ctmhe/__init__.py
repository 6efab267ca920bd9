"""ctmhe."""
