//! Files that the program writes, read by independent readers; and foreign and damaged files, read by the program.

mod damage;
mod directories;
mod earlier;
mod junit;
mod logs;
mod own_data;
#[cfg(feature = "parquet")]
mod parquet;
mod record;
