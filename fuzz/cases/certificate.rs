//! A client certificate: trust was decided before; the role in the certificate grants authority.
//!
//! Input: the certificate in DER.

use drivegate_north::modbus_tcp::certificate_role;

pub(crate) fn run(data: &[u8]) {
    let Some(role) = certificate_role(data) else { return };
    // DER has exactly one form: no byte may be added or cut off.
    let mut longer = data.to_vec();
    longer.push(0);
    assert_eq!(certificate_role(&longer), None);
    assert_eq!(certificate_role(&data[..data.len() - 1]), None);
    if let Ok(Some(role)) = role {
        assert!(role.len() <= 256);
        let bytes = role.as_bytes();
        assert!(bytes.is_empty() || data.windows(bytes.len()).any(|part| part == bytes));
    }
}
