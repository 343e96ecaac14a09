//! Writes changed copies of recordings.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;

/// Creates a writer of chunks like those of the program.
fn rewriter(to: &Path) -> mcap::Writer<std::io::BufWriter<std::fs::File>> {
    let options = mcap::WriteOptions::new().compression(Some(mcap::Compression::Lz4));
    options.create(std::io::BufWriter::new(std::fs::File::create(to).unwrap())).unwrap()
}

/// Writes a copy of a recording, as any MCAP tool could, with changed schemas and samples (by topic and tick). Samples
/// made empty are left out.
pub fn rewrite(from: &Path, to: &Path, schema: impl Fn(String) -> String, change: impl Fn(&str, u32, &mut Vec<u8>)) {
    let bytes = std::fs::read(from).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let mut writer = rewriter(to);
    for index in &summary.metadata_indexes {
        writer.write_metadata(&mcap::read::metadata(&bytes, index).unwrap()).unwrap();
    }
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let mut message = message.unwrap();
        let mut channel = (*message.channel).clone();
        let mut layout = (**channel.schema.as_ref().unwrap()).clone();
        layout.data = Cow::Owned(schema(String::from_utf8(layout.data.to_vec()).unwrap()).into_bytes());
        channel.schema = Some(layout.into());
        let mut data = message.data.to_vec();
        change(&channel.topic, message.sequence, &mut data);
        message.channel = channel.into();
        if !data.is_empty() {
            message.data = Cow::Owned(data);
            writer.write(&message).unwrap();
        }
    }
    writer.finish().unwrap();
}

/// Writes a copy of a recording, as any MCAP tool could, with changed metadata and correct checksums.
pub fn rewrite_metadata(from: &Path, to: &Path, change: impl Fn(&str, &mut BTreeMap<String, String>)) {
    let bytes = std::fs::read(from).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let mut writer = rewriter(to);
    for index in &summary.metadata_indexes {
        let mut metadata = mcap::read::metadata(&bytes, index).unwrap();
        metadata.metadata.remove("checksum");
        change(&metadata.name, &mut metadata.metadata);
        let mut hasher = xxhash_rust::xxh3::Xxh3::new();
        let texts = metadata.metadata.iter().flat_map(|(key, value)| [key, value]);
        for text in [&metadata.name].into_iter().chain(texts) {
            hasher.update(&(text.len() as u64).to_le_bytes());
            hasher.update(text.as_bytes());
        }
        metadata.metadata.insert("checksum".to_owned(), format!("{:016x}", hasher.digest()));
        writer.write_metadata(&metadata).unwrap();
    }
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        writer.write(&message.unwrap()).unwrap();
    }
    writer.finish().unwrap();
}
