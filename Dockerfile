# docker build -t nlos .
# docker run --rm -v "$PWD:/data" nlos look mine.hdf5
FROM python:3.12-slim
# What Open3D loads.
RUN apt-get update \
    && apt-get install -y --no-install-recommends libusb-1.0-0 libgl1 libegl1 libgomp1 libx11-6 \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /nlos_lit
COPY pyproject.toml setup.py constraints.txt README.md LICENSE ./
COPY conf conf
COPY data_modules data_modules
COPY nlos_lit nlos_lit
RUN pip install --no-cache-dir -c constraints.txt .
WORKDIR /data
ENTRYPOINT ["nlos"]
