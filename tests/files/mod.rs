//! Reads what the program writes, with foreign readers where there are any, and gives it foreign and damaged files to read.

mod damage;
mod directories;
mod junit;
mod own_data;
#[cfg(feature = "parquet")]
mod parquet;
mod record;
