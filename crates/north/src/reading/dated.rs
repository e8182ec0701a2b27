//! A stream whose reader records when the bytes arrived.

use std::fmt::Debug;
use std::io;
use std::os::fd::AsFd;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Instant;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use tokio::io::{AsyncRead, AsyncWrite, DuplexStream, ReadBuf};
use tokio::net::unix::pipe;
use tokio::net::{TcpStream, UnixStream};

use super::{FrameEnd, Reader};

/// Properties of a stream besides its bytes.
pub trait Source {
    /// Whether the source has bytes to read.
    fn is_readable(&self) -> bool;

    /// Whether the other end has closed or reset the connection, whatever is left to read. A client that has only
    /// finished writing, and still reads, looks the same until bytes are sent to it.
    fn has_gone(&self) -> bool;
}

fn shows(source: &impl AsFd, flags: PollFlags) -> bool {
    let mut fds = [PollFd::new(source, flags)];
    // If the system cannot answer, the connection counts as open.
    let any = poll(&mut fds, Some(&Timespec::default())).unwrap_or(0) > 0;
    any && fds.iter().any(|fd| fd.revents().intersects(flags))
}

/// Whether the source has something to read or accept.
pub fn is_readable(source: &impl AsFd) -> bool {
    shows(source, PollFlags::IN)
}

/// Properties of a socket of the system.
macro_rules! source {
    ($($type:ty),*) => {$(
        impl Source for $type {
            fn is_readable(&self) -> bool {
                is_readable(self)
            }

            fn has_gone(&self) -> bool {
                shows(self, PollFlags::RDHUP | PollFlags::HUP | PollFlags::ERR)
            }
        }
    )*};
}

source!(TcpStream, UnixStream);

impl Source for pipe::Receiver {
    fn is_readable(&self) -> bool {
        is_readable(self)
    }

    /// A program that closes a pseudo-terminal may have left orders that must still be carried out.
    fn has_gone(&self) -> bool {
        false
    }
}

/// A stream within the process cannot stall separately.
impl Source for DuplexStream {
    fn is_readable(&self) -> bool {
        false
    }

    fn has_gone(&self) -> bool {
        false
    }
}

/// Where the messages of a protocol begin and end.
pub trait Frames: Debug + Send + Sync {
    /// The next bytes; returns whether a message is complete with them.
    fn pass(&mut self, bytes: &[u8]) -> FrameEnd;
}

/// A stream with the reader that dates its bytes.
#[derive(Debug)]
pub struct Dated<S> {
    stream: S,
    reader: Arc<Reader>,
    frames: Option<Box<dyn Frames>>,
}

impl<S> Dated<S> {
    pub fn new(stream: S, reader: Arc<Reader>) -> Dated<S> {
        Dated {
            stream,
            reader,
            frames: None,
        }
    }

    /// A stream whose messages, in these frames, date from their first bytes in [`Reader::first`].
    pub fn in_frames(stream: S, reader: Arc<Reader>, frames: Box<dyn Frames>) -> Dated<S> {
        Dated {
            frames: Some(frames),
            ..Dated::new(stream, reader)
        }
    }

    pub fn reader(&self) -> &Arc<Reader> {
        &self.reader
    }

    pub fn stream(&self) -> &S {
        &self.stream
    }
}

impl<S: AsyncRead + Source + Unpin> AsyncRead for Dated<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let Dated { stream, reader, frames } = &mut *self;
        let (room, before) = (buffer.remaining(), buffer.filled().len());
        let polled = Pin::new(&mut *stream).poll_read(context, buffer);
        let now = Instant::now();
        match &polled {
            Poll::Pending => reader.nothing(now, || stream.is_readable()),
            Poll::Ready(Ok(())) => match buffer.filled().len() - before {
                0 if room > 0 => reader.ended(),
                0 => {}
                count => {
                    reader.note_read(now, count < room, || stream.has_gone());
                    if let (Some(frames), Some(bytes)) = (frames, buffer.filled().get(before..)) {
                        reader.note_end(frames.pass(bytes));
                    }
                }
            },
            Poll::Ready(Err(_)) => reader.ended(),
        }
        polled
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Dated<S> {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(context, bytes)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpListener;

    use super::*;

    async fn pair() -> (TcpStream, Dated<TcpStream>) {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let client = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        let (stream, _) = listener.accept().await.unwrap();
        (client, Dated::new(stream, Arc::new(Reader::here())))
    }

    #[tokio::test]
    async fn a_stream_dates_what_it_reads() {
        let (mut client, mut stream) = pair().await;
        let before = Instant::now();
        let writing = async {
            tokio::time::sleep(Duration::from_millis(20)).await;
            client.write_all(b"late").await.unwrap();
        };
        let mut buffer = [0; 16];
        let (read, ()) = tokio::join!(stream.read(&mut buffer), writing);
        assert_eq!(read.unwrap(), 4);
        let came = stream.reader().last().asked;
        assert!(came >= before + Duration::from_millis(20) && came <= Instant::now());
        client.write_all(b"at once").await.unwrap();
        tokio::time::sleep(Duration::from_millis(20)).await;
        assert_eq!(stream.read(&mut buffer).await.unwrap(), 7);
        let at_once = stream.reader().last().asked;
        assert!(
            at_once >= came && at_once < came + Duration::from_millis(20),
            "nobody read since"
        );
        assert!(!stream.reader().last().connection.is_gone());
        drop(client);
        assert_eq!(stream.read(&mut buffer).await.unwrap(), 0);
        assert!(stream.reader().last().connection.is_gone());
    }

    #[tokio::test]
    async fn a_client_that_has_gone_is_seen_behind_what_it_left() {
        let (mut client, stream) = pair().await;
        client.write_all(b"left").await.unwrap();
        assert!(!stream.stream().has_gone());
        drop(client);
        tokio::time::sleep(Duration::from_millis(20)).await;
        assert!(stream.stream().has_gone() && stream.stream().is_readable());
    }
}
