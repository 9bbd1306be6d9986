"""The pilot's page: posture, picture and health of a live run, in a browser."""
