"""Camera models: CAHV, CAHVOR, CAHVORE, their parameters, and points that several cameras see."""
