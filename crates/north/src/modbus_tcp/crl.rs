//! Certificate revocation lists of the CAs of clients.
//!
//! rustls checks clients against the lists. This code checks that rustls can do so: each list is signed by its CA,
//! and each CA has a list; otherwise a wrong file would refuse every client. An outdated list stays in force: its
//! revocations apply, and operators can still stop their drives if the CA fails to issue a new list.

use std::path::Path;
use std::time::SystemTime;

use rustls_pki_types::{CertificateDer, CertificateRevocationListDer};
use x509_cert::Certificate;
use x509_cert::crl::CertificateList;
use x509_cert::der::{Decode, Encode};

use crate::certificate;
use crate::identity::{FileProblem, date, provider, seconds};
use crate::pem;

/// The revocation lists of a file.
pub(super) type Crls = Vec<CertificateRevocationListDer<'static>>;

/// Reads the lists of a file, in PEM or DER, for the CAs `client_ca`; returns warnings with them.
///
/// # Errors
/// If the file is not usable: contains the fault.
pub(super) fn load(
    file: &Path,
    client_ca: &[CertificateDer<'_>],
    now: SystemTime,
) -> Result<(Crls, Vec<FileProblem>), FileProblem> {
    let lists = pem::revocation_lists(file)?;
    let shown = || file.display().to_string();
    let parsed: Result<Vec<CertificateList>, _> = lists.iter().map(|der| CertificateList::from_der(der)).collect();
    let parsed = parsed.map_err(|cause| FileProblem::UnusableCrl {
        file: shown(),
        cause: cause.to_string(),
    })?;
    let mut warnings = Vec::new();
    for ca in client_ca.iter().filter_map(|der| Certificate::from_der(der).ok()) {
        let issuer = || certificate::subject_name(&ca);
        let own = |list: &&CertificateList| list.tbs_cert_list.issuer == *ca.tbs_certificate().subject();
        let mut found = false;
        for list in parsed.iter().filter(own) {
            found = true;
            if !is_signed(list, &ca) {
                let issuer = issuer();
                return Err(FileProblem::ForeignCrl { issuer, file: shown() });
            }
            let end = list
                .tbs_cert_list
                .next_update
                .map(|time| time.to_unix_duration().as_secs());
            if let Some(end) = end.filter(|end| *end < seconds(now)) {
                warnings.push(FileProblem::OldCrl {
                    issuer: issuer(),
                    file: shown(),
                    end: date(end),
                });
            }
        }
        if !found {
            warnings.push(FileProblem::NoCrl {
                issuer: issuer(),
                file: shown(),
            });
        }
    }
    Ok((lists, warnings))
}

/// Whether the key of `ca` made the signature of `list`.
fn is_signed(list: &CertificateList, ca: &Certificate) -> bool {
    let key = ca.tbs_certificate().subject_public_key_info();
    let (Ok(message), Ok(algorithm)) = (list.tbs_cert_list.to_der(), list.signature_algorithm.to_der()) else {
        return false;
    };
    let (key, signature) = (key.subject_public_key.raw_bytes(), list.signature.raw_bytes());
    // The identifiers of rustls are without the tag and the length of the sequence.
    let algorithm = algorithm.get(2..).unwrap_or_default();
    let known = provider().signature_verification_algorithms.all;
    known
        .iter()
        .filter(|known| known.signature_alg_id().as_ref() == algorithm)
        .any(|known| known.verify_signature(key, &message, signature).is_ok())
}
