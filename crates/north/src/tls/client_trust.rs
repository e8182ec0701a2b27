//! Trust in clients: their CA certificates, and the certificate revocation lists of those.
//!
//! rustls checks clients against the lists. This code checks that rustls can do so: each list is signed by its CA,
//! and each CA has a list; otherwise a wrong file would refuse every client. An outdated list stays in force: its
//! revocations apply, and operators can still stop their drives if the CA fails to issue a new list.

use std::path::Path;
use std::sync::Arc;
use std::time::SystemTime;

use rustls::RootCertStore;
use rustls::server::danger::ClientCertVerifier;
use rustls::server::{VerifierBuilderError, WebPkiClientVerifier};
use rustls_pki_types::{CertificateDer, CertificateRevocationListDer};
use x509_cert::Certificate;
use x509_cert::crl::CertificateList;
use x509_cert::der::{Decode, Encode};

use super::certificate::{self, CertificateSummary};
use super::fault::{Problem, TlsFault, TlsFile};
use super::{date, pem, provider, seconds};

/// The revocation lists of a file.
type Crls = Vec<CertificateRevocationListDer<'static>>;

/// CA certificates and revocations with the content of their files; equal while the content is.
#[derive(Debug, Clone, PartialEq)]
pub struct ClientTrust {
    ca: Vec<CertificateDer<'static>>,
    crl: Crls,
}

impl ClientTrust {
    /// Reads the files and checks them at `now`; also returns warnings.
    ///
    /// # Errors
    /// If the files cannot be used; contains all faults.
    pub fn load(ca: &Path, crl: Option<&Path>, now: SystemTime) -> Result<(ClientTrust, Vec<TlsFault>), Vec<TlsFault>> {
        let mut errors = Vec::new();
        let anchors = pem::certificates(ca).map_err(|why| errors.push(TlsFile::Ca.fault(why)));
        let lists = crl.map(|file| revocations(file, anchors.as_deref().unwrap_or_default(), now));
        let lists = lists.transpose().map_err(|why| errors.push(TlsFile::Crl.fault(why)));
        let (Ok(anchors), Ok(lists)) = (anchors, lists) else {
            return Err(errors);
        };
        let (crl, doubts) = lists.unwrap_or_default();
        // An expired CA is still a valid trust anchor (RFC 5280, 6.1.1), so no client is refused for it.
        let of_anchors = anchors
            .iter()
            .flat_map(|anchor| certificate::problems(ca, anchor, now, CertificateSummary::unsupported_key));
        let of_anchors = of_anchors.map(|why| TlsFile::Ca.fault(why));
        let warnings = of_anchors.chain(doubts.into_iter().map(|why| TlsFile::Crl.fault(why)));
        let warnings = warnings.collect();
        let trust = ClientTrust { ca: anchors, crl };
        match trust.verifier() {
            Ok(_) => Ok((trust, warnings)),
            Err(fault) => Err(vec![fault]),
        }
    }

    /// The verifier for certificates of clients. If there are revocation lists, each CA in the chain of a client
    /// must have one; an outdated list remains in force.
    ///
    /// # Errors
    /// If a CA certificate or a list cannot be used.
    pub fn verifier(&self) -> Result<Arc<dyn ClientCertVerifier>, TlsFault> {
        let unusable_ca = |why: &str| TlsFile::Ca.fault(Problem::UnusableCa(why.to_string()));
        let mut roots = RootCertStore::empty();
        for anchor in &self.ca {
            let added = roots.add(anchor.clone());
            added.map_err(|_| unusable_ca("it is not valid X.509"))?;
        }
        WebPkiClientVerifier::builder_with_provider(Arc::new(roots), provider())
            .with_crls(self.crl.clone())
            .build()
            .map_err(|error| match error {
                VerifierBuilderError::InvalidCrl(error) => TlsFile::Crl.fault(Problem::UnsupportedCrl(error)),
                error => unusable_ca(&error.to_string()),
            })
    }
}

/// Reads the lists of a file, in PEM or DER, for the CAs `client_ca`; returns warnings with them.
///
/// # Errors
/// If the file is not usable: contains the fault.
fn revocations(
    file: &Path,
    client_ca: &[CertificateDer<'_>],
    now: SystemTime,
) -> Result<(Crls, Vec<Problem>), Problem> {
    let lists = pem::revocation_lists(file)?;
    let shown = || file.display().to_string();
    let parsed: Result<Vec<CertificateList>, _> = lists.iter().map(|der| CertificateList::from_der(der)).collect();
    let parsed = parsed.map_err(|cause| Problem::UnusableCrl {
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
                return Err(Problem::ForeignCrl { issuer, file: shown() });
            }
            let end = list
                .tbs_cert_list
                .next_update
                .map(|time| time.to_unix_duration().as_secs());
            if let Some(end) = end.filter(|end| *end < seconds(now)) {
                warnings.push(Problem::OldCrl {
                    issuer: issuer(),
                    file: shown(),
                    end: date(end),
                });
            }
        }
        if !found {
            warnings.push(Problem::NoCrl {
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
