#!/bin/sh
# Creates what [modbus_tcp.tls] needs: a CA, a server certificate, client certificates with roles.
# For tests and small plants; use your company CA if there is one. Needs openssl.
#
#   modbus-tls-ca.sh DIR ca                       a CA: DIR/ca.crt, DIR/ca.key
#   modbus-tls-ca.sh DIR server NAME [HOST...]    DIR/NAME.crt, DIR/NAME.key, for these names and addresses
#                                                 (default: localhost 127.0.0.1 ::1)
#   modbus-tls-ca.sh DIR client NAME [ROLE]       DIR/NAME.crt, DIR/NAME.key; without a role it may only read
#   modbus-tls-ca.sh DIR revoke NAME...           revokes DIR/NAME.crt, and writes the list DIR/ca.crl for client_crl
#   modbus-tls-ca.sh DIR crl                      DIR/ca.crl anew, before it is out of date
#
# DAYS sets the validity of a certificate (default 825; the CA: ten years; a revocation list: 365). Existing files are not replaced.
# Keys are readable by their owner only; keep DIR/ca.key safe and secret.
set -eu

# The role is an extension of the certificate (Modbus/TCP Security protocol specification), a UTF8String.
role_oid=1.3.6.1.4.1.50316.802.1

fail() { echo "error: $*" >&2; exit 2; }
usage="write: $0 DIR ca | server NAME [HOST...] | client NAME [ROLE] | revoke NAME... | crl"

[ $# -ge 2 ] || fail "no command; $usage"
dir=$1 command=$2
shift 2
umask 077
mkdir -p "$dir"

absent() {
    for file in "$@"; do
        [ ! -e "$file" ] || fail "$file is there already; move it away first, or choose another name"
    done
}

# Distinguished names and extension files are text with signs of their own; nothing of them may come in by a name.
plain() {
    case $1 in
        '' | *[!A-Za-z0-9._:@\ -]*) fail "\`$1\` cannot be used here; write letters, digits, blanks and . _ : @ -" ;;
    esac
}

new_key() {
    openssl ecparam -name prime256v1 -genkey -noout | openssl pkcs8 -topk8 -nocrypt -out "$1"
}

# sign NAME: signs DIR/NAME.key's certificate with the extensions of standard input.
sign() {
    [ -r "$dir/ca.key" ] || fail "$dir/ca.key is missing; run $0 $dir ca first"
    openssl req -new -key "$dir/$1.key" -subj "/CN=$1" -out "$dir/$1.csr"
    cat >"$dir/$1.ext"
    openssl x509 -req -in "$dir/$1.csr" -CA "$dir/ca.crt" -CAkey "$dir/ca.key" -set_serial "0x00$(openssl rand -hex 15)" \
        -days "${DAYS:-825}" -sha256 -extfile "$dir/$1.ext" -out "$dir/$1.crt"
    rm "$dir/$1.csr" "$dir/$1.ext"
    chmod 644 "$dir/$1.crt"
}

# authority OPTION...: openssl's book of revoked certificates, DIR/ca.index.
authority() {
    [ -r "$dir/ca.key" ] || fail "$dir/ca.key is missing; run $0 $dir ca first"
    [ -e "$dir/ca.index" ] || : >"$dir/ca.index"
    [ -e "$dir/ca.crlnumber" ] || echo 01 >"$dir/ca.crlnumber"
    cat >"$dir/ca.cnf" <<END
[ca]
default_ca = book
[book]
database = $dir/ca.index
crlnumber = $dir/ca.crlnumber
default_md = sha256
# Without extensions a list has version 1, which is not accepted any more.
crl_extensions = extensions
[extensions]
authorityKeyIdentifier = keyid:always
END
    openssl ca -config "$dir/ca.cnf" -cert "$dir/ca.crt" -keyfile "$dir/ca.key" "$@"
    rm "$dir/ca.cnf"
}

case $command in
    ca)
        absent "$dir/ca.key" "$dir/ca.crt"
        new_key "$dir/ca.key"
        openssl req -x509 -new -key "$dir/ca.key" -sha256 -days "${DAYS:-3650}" -subj "/CN=drivegate test CA" \
            -addext "basicConstraints=critical,CA:TRUE" -addext "keyUsage=critical,keyCertSign,cRLSign" -out "$dir/ca.crt"
        chmod 644 "$dir/ca.crt"
        ;;
    server)
        [ $# -ge 1 ] || fail "no name; $usage"
        name=$1
        shift
        [ $# -ge 1 ] || set -- localhost 127.0.0.1 ::1
        plain "$name"
        absent "$dir/$name.key" "$dir/$name.crt"
        names=
        for host in "$@"; do
            plain "$host"
            case $host in
                *:*) names="$names${names:+,}IP:$host" ;;
                *[!0-9.]*) names="$names${names:+,}DNS:$host" ;;
                *) names="$names${names:+,}IP:$host" ;;
            esac
        done
        new_key "$dir/$name.key"
        sign "$name" <<END
basicConstraints=critical,CA:FALSE
keyUsage=critical,digitalSignature
extendedKeyUsage=serverAuth
subjectAltName=$names
END
        ;;
    client)
        [ $# -ge 1 ] || fail "no name; $usage"
        name=$1 role=${2:-}
        plain "$name"
        [ -z "$role" ] || plain "$role"
        absent "$dir/$name.key" "$dir/$name.crt"
        new_key "$dir/$name.key"
        sign "$name" <<END
basicConstraints=critical,CA:FALSE
keyUsage=critical,digitalSignature
extendedKeyUsage=clientAuth
${role:+$role_oid=ASN1:UTF8String:$role}
END
        ;;
    revoke)
        [ $# -ge 1 ] || fail "no name; $usage"
        for name in "$@"; do
            [ -r "$dir/$name.crt" ] || fail "$dir/$name.crt is missing; name a certificate in $dir"
            authority -revoke "$dir/$name.crt"
        done
        authority -gencrl -crldays "${DAYS:-365}" -out "$dir/ca.crl"
        chmod 644 "$dir/ca.crl"
        ;;
    crl)
        authority -gencrl -crldays "${DAYS:-365}" -out "$dir/ca.crl"
        chmod 644 "$dir/ca.crl"
        ;;
    *) fail "unknown command \`$command\`; $usage" ;;
esac
