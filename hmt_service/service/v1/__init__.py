"""Protobuf code generated from proto/hmt_service/service/v1/hmt.proto; do not edit."""
