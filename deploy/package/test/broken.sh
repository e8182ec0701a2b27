#!/bin/sh
# A version that likes the configuration and cannot start.
[ "$1" != run ] || exit 1
exec REAL "$@"
