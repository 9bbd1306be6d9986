# aqualvs as a container, and as an extension of BlueOS; see docs/blueos.md.
FROM python:3.11-slim

COPY pyproject.toml README.md LICENSE /src/
COPY src /src/src
RUN pip install --no-cache-dir '/src[live]' && rm -rf /src

# Compiled kernels are kept here, so that only the first start takes long.
ENV NUMBA_CACHE_DIR=/data/kernels
VOLUME /data
WORKDIR /data
EXPOSE 8100

LABEL version="0.1.0"
LABEL type="tool"
LABEL authors='[{"name": "The aqualvs founders", "email": "aqualvs@example.org"}]'
LABEL company='{"about": "Underwater laser vision", "name": "aqualvs", "email": "aqualvs@example.org"}'
LABEL tags='["navigation", "distance", "aquaculture"]'
LABEL requirements="core >= 1.1"
LABEL permissions='{"ExposedPorts": {"8100/tcp": {}, "5600/udp": {}}, "HostConfig": {"Binds": ["/usr/blueos/extensions/aqualvs:/data"], "ExtraHosts": ["host.docker.internal:host-gateway"], "NetworkMode": "host"}}'

# The rig lies in /data; source and autopilot are those of a BlueROV2 and can be set.
ENV AQUALVS_SOURCE=udp://0.0.0.0:5600 AQUALVS_RIG=/data/rig.yaml AQUALVS_MAVLINK=tcp:127.0.0.1:5777
CMD ["sh", "-c", "exec aqualvs live \"$AQUALVS_SOURCE\" --rig \"$AQUALVS_RIG\" --mavlink \"$AQUALVS_MAVLINK\" --dashboard --dashboard-address 0.0.0.0:8100 --record-to /data/dives"]
