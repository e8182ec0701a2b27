# For the scripts that install tools: which Debian packages are missing. Sourced; wants `needed` (what must be on the PATH or, with a
# slash, on disk, and the package that brings it) and `fail`.

as_root() {
    if [ "$(id -u)" = 0 ]; then
        "$@"
    elif command -v sudo >/dev/null; then
        sudo "$@"
    else
        fail "cannot install packages; in $0, as user $(id -un) without sudo; run as root: apt-get install ${packages[*]}"
    fi
}

missing_packages() {
    local entry what package
    for entry in "${needed[@]}"; do
        read -r what package <<<"$entry"
        case $what in
            /*) [ -e "$what" ] || echo "$package" ;;
            *) command -v "$what" >/dev/null || echo "$package" ;;
        esac
    done
    python3 -c 'import ensurepip, venv' 2>/dev/null || echo python3-venv
}
