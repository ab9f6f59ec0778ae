"""Configuration: composed by Hydra (:mod:`.composition`), bound to what it configures (:mod:`.binding`)."""
