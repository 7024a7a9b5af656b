"""Message definitions: parser, registry, distros, hashes."""
