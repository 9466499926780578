# docker build -t workbook . && docker run --rm -it workbook
# The devcontainer uses the first stage, with the checkout that is opened. For a build of PyTorch
# from another index: --build-arg INDEX=…
FROM python:3.11-slim AS tools
RUN apt-get update && apt-get install -y --no-install-recommends git make && rm -rf /var/lib/apt/lists/*

FROM tools
ARG INDEX=
WORKDIR /workbook
COPY . .
RUN make setup INDEX="$INDEX"
CMD ["make", "workbook"]
