"""MAVLink: the connection, its peers and ports, and ArduSub behind it."""
